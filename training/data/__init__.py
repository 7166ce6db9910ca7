"""Training data: renders, the random camera, triplets made of both, and real photos."""
