"""Registry of the simulated effects, in the order of the light path from lamp to counts; the calibration's last."""

from device.sim.effects import eye, illumination, optics, sensor
from device.sim.effects.effect import Effect

EFFECTS: tuple[Effect, ...] = (
    eye.Tint(),
    illumination.Penumbra(),
    illumination.Falloff(),
    illumination.Leds(),
    eye.Reflex(),
    illumination.Stray(),
    illumination.Ambient(),
    eye.RefractiveError(),
    eye.Accommodation(),
    eye.ChromaticFocus(),
    eye.FieldCurvature(),
    eye.ObliqueAstigmatism(),
    eye.RetinaTilt(),
    eye.TearFilm(),
    optics.PupilVignetting(),
    optics.Bandwidth(),
    eye.Motion(),
    sensor.RollingShutter(),
    sensor.Prnu(),
    sensor.BayerMosaic(),
    sensor.ShotNoise(),
    sensor.DarkCurrent(),
    sensor.Dsnu(),
    sensor.HotPixels(),
    sensor.ReadNoise(),
    sensor.Nonlinearity(),
    sensor.Saturation(),
    sensor.Quantisation(),
    optics.SourceSize(),
)
