"""The contact-formation map: closed configurations over the plane of x and phi."""
