"""Novelty signals: what is read off an encoder."""
