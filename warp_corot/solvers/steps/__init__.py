"""How long a stable step is, at rest and while the state changes."""
