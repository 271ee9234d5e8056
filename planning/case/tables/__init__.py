"""The tables of a case file, key by key: the schema that each one must satisfy."""
