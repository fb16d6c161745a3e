"""Program to C text: expressions printed, templates filled, texts remembered."""
