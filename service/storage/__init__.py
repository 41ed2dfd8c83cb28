"""The database, the files and the home folder of the service."""
