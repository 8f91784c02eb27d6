"""What can be trusted in files, labels and splits; a leak stops the chain (stage `audit`)."""
