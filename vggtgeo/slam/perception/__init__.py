"""What is seen in one image, or by comparing two, before anything is known of a map."""
