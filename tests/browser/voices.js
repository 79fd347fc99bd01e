// Stub of speech synthesis, because a headless browser has no voices: `spoken` records the sentences, and each lasts
// until the next. `voices` are the available languages; a voice with "!" fails without the internet, one with "?" never
// starts.
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
