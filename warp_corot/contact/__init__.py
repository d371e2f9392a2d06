"""Contact of soft bodies with obstacles and with one another."""
