"""Force plans, derived by launches: for fixed forests and, with ``changing``, for forests that change."""
