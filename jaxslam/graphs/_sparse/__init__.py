"""Block-sparse linear algebra: order of elimination, Cholesky factor, selected inverse."""
