"""Throughput of batches of states: in process, beside other libraries, on a GPU and over transports."""
