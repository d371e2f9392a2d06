"""What users hand in, checked: numbers, indices, devices, keyframes, expressions that select nodes."""
