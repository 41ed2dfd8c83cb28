"""Files that hold recordings, one format a module: each is read as a table of named columns, block after block."""
