"""How far a run can be trusted: one check a file, each a pure function, and the verdict they add up to."""
