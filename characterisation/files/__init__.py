"""What both packages stand on: errors, documents and files that are read with limits and written whole."""
