#!/bin/sh
# Called by rpi-image-gen up to 2.8 with the root file system and genimage's configuration folder; later versions call
# diffuscope-card.d/hooks/preimage10-card.
set -eu
cp genimage.cfg "$2/genimage.cfg"
