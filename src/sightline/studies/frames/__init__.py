"""The study of frames: kinds, designs and what handling does to them."""
