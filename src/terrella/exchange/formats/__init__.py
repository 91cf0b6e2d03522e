"""One file a format: each reads it into a Source and, where it can, writes a Source as it."""
