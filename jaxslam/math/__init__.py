"""General mathematics: angles, SE(2), linear algebra, statistics, array types."""
