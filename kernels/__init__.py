"""The pixel kernels: OpenCL C, their host code, and a NumPy twin of each. Imported as ``dior_rt.kernels``."""
