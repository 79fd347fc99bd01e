"""Facts of Debian's kernel that image, units and the boots in QEMU depend on: trixie, linux 6.12.118-1.

They are copied from /boot/config-6.12.118+deb13-ARCH of linux-image-ARCH; "y" is built in, "m" a module, "n" absent.

"""

_BOTH = {
    "BLK_DEV_LOOP": "m",
    "CFG80211": "m",
    "DM_CRYPT": "m",
    "DM_VERITY": "m",
    "EXFAT_FS": "m",
    "EXT4_FS": "m",
    "GPIO_CDEV": "y",
    "I2C_CHARDEV": "m",
    "MEDIA_CONTROLLER": "y",
    "MMC_SDHCI": "m",
    "NLS_ASCII": "m",
    "NLS_CODEPAGE_437": "m",
    "OVERLAY_FS": "m",
    "SPI_SPIDEV": "y",
    "SQUASHFS": "m",
    "SQUASHFS_ZSTD": "y",
    "USB_STORAGE": "m",
    "VFAT_FS": "m",
    "VIDEO_DEV": "m",
    "VIDEO_VIVID": "m",
    "VIRTIO_BLK": "m",
}
CONFIG = {
    "amd64": {
        **_BOTH,
        "DMABUF_HEAPS_SYSTEM": "y",
        "GPIO_PL061": "n",
        "I2C_GPIO": "n",
        "I2C_STUB": "m",
        "SPI_GPIO": "n",
    },
    "arm64": {
        **_BOTH,
        "DMABUF_HEAPS_SYSTEM": "n",
        "GPIO_PL061": "y",
        "I2C_GPIO": "m",
        "I2C_STUB": "n",
        "SPI_GPIO": "m",
    },
}

# Option that mounts a file system type, and that makes a udev subsystem or the character devices of DeviceAllow=.
FILE_SYSTEMS = {
    "exfat": "EXFAT_FS",
    "ext4": "EXT4_FS",
    "overlay": "OVERLAY_FS",
    "squashfs": "SQUASHFS",
    "vfat": "VFAT_FS",
}
SUBSYSTEMS = {
    "dma_heap": "DMABUF_HEAPS_SYSTEM",
    "gpio": "GPIO_CDEV",
    "i2c-dev": "I2C_CHARDEV",
    "ieee80211": "CFG80211",
    "spidev": "SPI_SPIDEV",
}
DEVICES = {
    "dma_heap": "DMABUF_HEAPS_SYSTEM",
    "gpiochip": "GPIO_CDEV",
    "i2c": "I2C_CHARDEV",
    "media": "MEDIA_CONTROLLER",
    "spi": "SPI_SPIDEV",
    "video4linux": "VIDEO_DEV",
}
MODULES = {"i2c-dev": "I2C_CHARDEV", "spidev": "SPI_SPIDEV", "videodev": "VIDEO_DEV"}

# Debian's kernel of that processor lacks them, and the card runs without: only libcamera opens dma_heap.
LACKS = {"amd64": set[str](), "arm64": {"DMABUF_HEAPS_SYSTEM"}}
