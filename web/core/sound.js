// Tones from oscillators (no audio files); loaded with the first tone. Each tone has its own melody.

const NOTES = {
  ready: [[880, 0, 0.1]],
  taken: [[1320, 0, 0.05]],
  good: [[660, 0, 0.12], [990, 0.13, 0.22]], // rising
  poor: [[392, 0, 0.16], [262, 0.18, 0.3]], // falling
}; // [frequency in Hz, start, length]
const GAIN = 0.2;
const RAMP_S = 0.01; // amplitude ramp, which prevents clicks

let context = null;

/** Play a melody. Browsers stay silent before the first touch of the page. */
export function play(name) {
  context ??= new AudioContext();
  if (context.state === "suspended") context.resume();
  for (const [hz, beginS, lengthS] of NOTES[name]) note(hz, context.currentTime + beginS, lengthS);
}

function note(hz, atS, lengthS) {
  const tone = new OscillatorNode(context, { frequency: hz });
  const volume = new GainNode(context, { gain: 0 });
  volume.gain.setValueAtTime(0, atS);
  volume.gain.linearRampToValueAtTime(GAIN, atS + RAMP_S);
  volume.gain.setValueAtTime(GAIN, atS + lengthS - RAMP_S);
  volume.gain.linearRampToValueAtTime(0, atS + lengthS);
  tone.connect(volume).connect(context.destination);
  tone.start(atS);
  tone.stop(atS + lengthS);
}
