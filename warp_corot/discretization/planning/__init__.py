"""Force plans, derived by launches: of forests that stay as they are and, with ``changing``, of those that change."""
