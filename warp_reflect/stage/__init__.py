"""USD in and out: the only users of pxr."""
