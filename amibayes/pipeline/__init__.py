"""From files to the statement: prepare, search, limits, posterior."""
