"""Pages that move: a model as one HTML file that computes its motion in the browser."""
