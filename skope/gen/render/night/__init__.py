"""The night camera: metering, two exposures, veiling glare, noise, denoising and the curve."""
