"""What happens along the rays of pixels."""
