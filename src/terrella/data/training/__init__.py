"""Reading for training: a recording as memory-mapped arrays, and seeded, resumable batches of clips from it."""
