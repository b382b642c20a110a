"""One method a file; see `warp_reflect.techniques.TECHNIQUES`."""
