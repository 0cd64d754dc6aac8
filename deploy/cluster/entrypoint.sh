#!/bin/sh
# Start of a container: topspin-entrypoint MODULE [flags], as after `python -m`.
# The image holds compiled kernels, but numba reads them only where it may write. So each start copies them (20 MB).
set -eu
kept="$XDG_CACHE_HOME/topspin/numba"
if [ ! -d "$kept" ] && [ -d /opt/topspin/.numba_cache ]; then
    mkdir -p "$XDG_CACHE_HOME/topspin"
    cp -R /opt/topspin/.numba_cache "$kept"
fi
exec python -m "$@"
