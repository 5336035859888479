"""What a run leaves: a value in memory, files in a folder, and the way back."""
