"""Which candidates the arm can reach: a standoff pose and a straight insertion, free of contacts and singularities."""
