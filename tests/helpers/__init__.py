"""What several tests share: small datasets and models, malformed inputs, writers of event files, and runners."""
