"""What is kept: database, files, the home folder."""
