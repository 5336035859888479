"""The whole map: loops, the last adjustment, how well poses are known after it."""
