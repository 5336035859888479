"""Bundle adjustment: the problem, its terms, solving it, and what the solution knows."""
