"""Video from events alone: motion and log images from the same events."""
