"""Recordings: the one form that all dataset formats are read into, handed to Nerfstudio, and written."""
