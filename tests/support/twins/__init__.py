"""Plain NumPy twins of kernels, which the tests compare with."""
