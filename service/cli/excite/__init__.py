"""`lipserve excite`: a motion within a robot's limits that tells its model most."""
