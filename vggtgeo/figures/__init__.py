"""Pictures of results (matplotlib)."""
