"""Intensity images from events alone: a filter, and networks whose weights the user has."""
