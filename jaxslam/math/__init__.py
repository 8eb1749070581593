"""Mathematics that knows nothing of robots' maps: angles, SE(2), linear algebra, statistics."""
