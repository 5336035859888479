"""The verdict: can the result of a run be trusted, where not, and why."""
