"""Views of a run in the Rerun viewer. Rerun is imported by the files of this folder alone, when a view is asked for."""
