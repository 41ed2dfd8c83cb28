"""The Open Inference Protocol (KServe V2) over HTTP, with the binary tensor data extension."""
