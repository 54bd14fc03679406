"""Looking at datasets, vehicles, towns and the installation; nothing else imports it."""
