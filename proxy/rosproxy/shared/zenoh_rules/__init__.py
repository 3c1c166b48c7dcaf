"""Rules and limits of topics in the form of zenoh's access control. All pure."""
