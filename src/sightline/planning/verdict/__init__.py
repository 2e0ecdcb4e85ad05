"""What a plan is judged by: errors, movement, the bone, the views' directions, other wires, the implant."""
