"""Measurements of the code: speed, accuracy, the blind test, the layout. No part of the installed package."""
