"""What a camera makes of a night: metering, two exposures, veiling glare, noise, denoising and its curve."""
