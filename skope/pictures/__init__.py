"""Drawing on images, and writing of images and videos."""
