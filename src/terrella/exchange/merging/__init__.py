"""Several robots in one training set: which number is which, and the merged recording."""
