"""How a body is held where the user does not say."""
