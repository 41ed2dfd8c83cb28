"""What the owner of a learning model sees and decides: its log, what is undone, how it learns."""
