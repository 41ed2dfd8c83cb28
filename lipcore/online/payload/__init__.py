"""What a stream's arm carries, weighed against contacts and other friction."""
