"""Analysis of a problem: covariances and observability."""
