"""Is the covariance honest on real data? Five robots of MRCLAM 6 with their true paths."""
