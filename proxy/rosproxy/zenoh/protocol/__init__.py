"""What rmw_zenoh and zenoh's routers tell, as data."""
