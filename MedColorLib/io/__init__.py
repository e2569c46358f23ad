"""Files: volumes in and out. A reader for each family of formats; `files` chooses among them."""
