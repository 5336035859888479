"""The global map: loop closure, global adjustment, and pose uncertainty."""
