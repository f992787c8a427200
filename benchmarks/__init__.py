"""Measurements of the code: speed, accuracy, the blind test, the state of the house. No part of the installed package."""
