"""Commands of the digital twin: simulated images, and accuracy studies on them."""
