"""Files that are written whole, named as OpenUSD names them, and read quietly."""
