"""Show a run in the Rerun viewer. Only this package imports Rerun, inside functions, since the import is slow."""
