// Stands in for the tablet's voices, which a headless browser has not: what was said is kept in `spoken`, and every
// sentence lasts until the next. `voices` are its languages; one with "!" needs an internet that is not there, and one with
// "?" waits for it for ever.
window.spoken = [];
window.voices = ["en-GB", "hi_IN", "ta-IN", "te-IN"];
window.SpeechSynthesisUtterance = class {
  constructor(text) {
    this.text = text;
  }
};
Object.defineProperty(window, "speechSynthesis", {
  value: Object.assign(new EventTarget(), {
    getVoices: () => window.voices.map((name) => ({ name, lang: name.slice(0, 5), localService: name.length === 5 })),
    speak(words) {
      this.now = words;
      window.spoken.push({ text: words.text, lang: words.lang });
      if (words.voice.localService) setTimeout(() => words.onstart());
      else if (words.voice.name.endsWith("!")) setTimeout(() => words.onerror({ error: "network" }));
    },
    cancel() {
      const words = this.now;
      this.now = null;
      if (words) window.spoken.push({ ended: words.text });
      if (words) setTimeout(() => words.onerror({ error: "interrupted" }));
    },
  }),
});
