"""Views of a run in the Rerun viewer. Rerun is imported in this folder alone, when a view is asked for."""
