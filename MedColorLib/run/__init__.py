"""A run: what is decided before computing (`prepare`), what computes (`engine`, `paint`), what is kept and foretold."""
