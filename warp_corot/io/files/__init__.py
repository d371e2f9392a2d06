"""Files: writing them completely, naming them for OpenUSD, and reading them quietly."""
