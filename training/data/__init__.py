"""Training data: renders, the random camera, triplets from both, and real photos."""
