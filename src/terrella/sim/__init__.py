"""Ground truth as Worlds: Doom, Gymnasium, replay of recordings."""
