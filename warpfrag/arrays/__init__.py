"""Array kinds in and out, autograd and tape recording, parallel kernel launches."""
