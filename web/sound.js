// Tones, made by oscillators: no files, and loaded when the first one is due. Each can be told from the others by its melody.

const NOTES = {
  ready: [[880, 0, 0.1]],
  taken: [[1320, 0, 0.05]],
  good: [[660, 0, 0.12], [990, 0.13, 0.22]], // up
  poor: [[392, 0, 0.16], [262, 0.18, 0.3]], // down
}; // Hz, beginning and length in seconds
const LOUD = 0.2;
const EDGE_S = 0.01; // a tone that begins or ends at once clicks

let context = null;

/** Play one of the melodies. The page must have been touched before: browsers keep silent until then. */
export function play(name) {
  context ??= new AudioContext();
  if (context.state === "suspended") context.resume();
  for (const [hz, begin_s, long_s] of NOTES[name]) note(hz, context.currentTime + begin_s, long_s);
}

function note(hz, at_s, long_s) {
  const tone = new OscillatorNode(context, { frequency: hz });
  const volume = new GainNode(context, { gain: 0 });
  volume.gain.setValueAtTime(0, at_s);
  volume.gain.linearRampToValueAtTime(LOUD, at_s + EDGE_S);
  volume.gain.setValueAtTime(LOUD, at_s + long_s - EDGE_S);
  volume.gain.linearRampToValueAtTime(0, at_s + long_s);
  tone.connect(volume).connect(context.destination);
  tone.start(at_s);
  tone.stop(at_s + long_s);
}
