"""Measure a true body as cameras and a tracker would."""
