"""References: pictures, folders, colour volumes and libraries become tissue colours with a mask."""
