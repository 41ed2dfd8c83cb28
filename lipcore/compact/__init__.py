"""The compact posterior: as large as the motion is varied, however many samples it has learnt from."""
