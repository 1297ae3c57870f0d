"""An event camera in a scene that is made up."""
