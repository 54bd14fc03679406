"""What commands say and are asked: options, messages, progress, tables."""
