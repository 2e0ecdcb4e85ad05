"""What images taken after planning show: wires in the bone, check shots, shots while drilling."""
