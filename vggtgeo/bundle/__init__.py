"""Bundle adjustment: the problem, its terms, the solver, and the analysis of a solution."""
