"""What arrays and kernels are made of: kinds of arrays, precisions, operators, launches."""
