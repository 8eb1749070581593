"""What is said of an optimum: marginal covariances, a certificate."""
