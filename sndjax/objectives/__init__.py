"""Self-supervised objectives: what shapes an encoder."""
