"""What a problem determines and how well: covariances, observability."""
