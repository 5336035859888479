"""Views of a run in the Rerun viewer. Rerun is optional: only this package imports it, inside functions."""
