"""The corotated law."""
