// Stands in for the tablet's voices, which a headless browser has not: what was said is kept in `spoken`, and every
// sentence lasts until the next. `voices` are its languages; one that ends in "!" is there and is never heard.
window.spoken = [];
window.voices = ["en-GB", "hi_IN", "ta-IN", "te-IN"];
window.SpeechSynthesisUtterance = class {
  constructor(text) {
    this.text = text;
  }
};
Object.defineProperty(window, "speechSynthesis", {
  value: Object.assign(new EventTarget(), {
    getVoices: () => window.voices.map((name) => ({ name, lang: name.replace("!", ""), localService: !name.endsWith("!") })),
    speak(words) {
      this.now = words;
      window.spoken.push({ text: words.text, lang: words.lang });
      setTimeout(() => (words.voice.name.endsWith("!") ? words.onerror({ error: "network" }) : words.onstart?.()));
    },
    cancel() {
      const words = this.now;
      this.now = null;
      if (words) window.spoken.push({ ended: words.text });
      if (words) setTimeout(() => words.onerror({ error: "interrupted" }));
    },
  }),
});
