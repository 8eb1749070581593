"""The sparse canonical form: state, links, sparsification, mean recovery."""
