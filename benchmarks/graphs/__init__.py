"""Is a graph honest about its own covariance?"""
