"""Systems of any number of coordinates: sums of few kinds of terms over indices."""
