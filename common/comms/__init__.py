"""Messages and the transports they travel over."""
