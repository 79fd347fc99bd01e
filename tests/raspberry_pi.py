"""Facts of Raspberry Pi's software that the card and the drivers depend on, each with its source.

They are copied by hand: where a newer release differs, change the fact and its source together.
"""

# Options of the kernel of a Raspberry Pi 5, "y" built in, "m" a module: raspberrypi/linux,
# arch/arm64/configs/bcm2712_defconfig at commit 00527380ab0ac773d616d1056901948303b332cb.
# Not in that file: SQUASHFS_ZLIB (fs/squashfs/Kconfig, default y), VIDEO_DEV (drivers/media/Kconfig, default
# MEDIA_SUPPORT, which is m).
KERNEL = {
    "ARM64_16K_PAGES": "y",
    "BCM2835_WDT": "y",
    "BLK_DEV_LOOP": "y",
    "DMABUF_HEAPS_CMA": "y",
    "DMABUF_HEAPS_SYSTEM": "y",
    "DM_CRYPT": "m",
    "DM_VERITY": "m",
    "EXFAT_FS": "m",
    "EXT4_FS": "y",
    "I2C_CHARDEV": "m",
    "I2C_DESIGNWARE_CORE": "m",
    "MMC_SDHCI": "y",
    "OVERLAY_FS": "m",
    "RASPBERRYPI_FIRMWARE": "y",
    "SENSORS_RASPBERRYPI_HWMON": "m",
    "SPI_DW_MMIO": "m",
    "SPI_SPIDEV": "m",
    "SQUASHFS": "m",
    "SQUASHFS_LZO": "y",
    "SQUASHFS_XATTR": "y",
    "SQUASHFS_XZ": "y",
    "SQUASHFS_ZLIB": "y",
    "SQUASHFS_ZSTD": "y",
    "VFAT_FS": "y",
    "VIDEO_DEV": "m",
    "VIDEO_IMX296": "m",
    "VIDEO_IMX477": "m",
    "VIDEO_RASPBERRYPI_PISP_BE": "m",
    "VIDEO_RP1_CFE": "m",
    "VIDEO_VIVID": "m",
}

# The same file, which names neither; asked for in raspberrypi/linux issues 2006 and 2194, which were closed.
KERNEL_LACKS = ("SQUASHFS_LZ4", "I2C_STUB")

# Module of an option of KERNEL, where a device node depends on it.
MODULES = {"I2C_CHARDEV": "i2c-dev", "SPI_SPIDEV": "spidev", "VIDEO_DEV": "videodev"}

# raspberrypi/libcamera v0.7.1+rpt20260429 (26bfadc66e8d7f727a993fe58174217b8a96f7f9), src/ipa/rpi/pisp/data/NAME.json,
# rpi.black_level, on a scale of 16 bits. A sensor without an entry is not in src/ipa/rpi/cam_helper there.
BLACK_LEVELS = {
    "imx219": 4096,
    "imx283": 3200,
    "imx296": 3840,
    "imx477": 4096,
    "imx500": 4096,
    "imx519": 4096,
    "imx708": 4096,
    "ov9281": 4096,
}

# The same, src/ipa/rpi/cam_helper/cam_helper_imx708.cpp: gain 1024 / (1024 - code); the driver's lowest code is 112.
IMX708_LOWEST_GAIN = 1024 / (1024 - 112)

# RPi-Distro/raspberrypi-sys-mods, etc.armhf/udev/rules.d/99-com.rules at 05cfe136f76677a891a0c77dc91d796913607c07 and
# usr/lib/udev/rules.d/60-dma-heap.rules: subsystem and group. Debian's own rules (50-udev-default.rules of systemd)
# name groups of video4linux and media only.
GROUPS = {"spidev": "spi", "i2c-dev": "i2c", "gpio": "gpio", "dma_heap": "video"}
DEBIAN_GROUPS = {"video4linux": "video", "media": "video"}

# Raspberry Pi documentation, "Real Time Clock (RTC)", "Enable battery charging": rtc_bbat_vchg in microvolts, without
# which the cell at J5 is not charged.
CLOCK_CELL_UV = 3_000_000
