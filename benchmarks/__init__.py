"""The measurements behind the project's figures. They run from the repository's root and are not installed."""
