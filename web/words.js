// Every text that the page itself says, and how to say it. Words about faults and light come from the instrument
// ({code, message, remedy}) and are shown as they are: the page has no opinion of its own about safety.

const ENGLISH = {
  "app.name": "Diffuscope",
  "chip.simulated": "SIMULATED",
  "chip.simulated.why": "No real eye: these pictures are simulated.",
  "chip.recording": "RECORDING",
  "chip.recording.why": "No live eye: a recording is being played.",
  "state.opening": "Connecting",
  "state.starting": "Getting ready",
  "state.making": "Making the picture",
  "state.aim": "Ready",
  "state.busy": "Taking",
  "state.lost": "No link",

  "eye.choose": "Which eye",
  "eye.OD": "Right eye (OD)",
  "eye.OS": "Left eye (OS)",
  "eye.OD.short": "Right",
  "eye.OS.short": "Left",

  "part.live": "Live picture and result",
  "part.controls": "Controls",
  "part.tools": "Picture tools",
  "part.strip": "Last pictures",

  "aim.live": "Live picture of the retina, with an aiming ring",
  "aim.waiting": "Waiting for the live picture…",
  "aim.late": "{s} s old",
  "aim.prompt": "Bring the retina into the ring. Then take the picture.",
  "aim.starting": "The instrument is getting ready. You may press: the picture is taken as soon as it is.",
  "aim.making": "The last picture is still being made. You may take another.",
  "aim.busy": "A picture is being taken. Please wait.",
  "take": "Take picture",
  "take.hold": "Hold still",
  "take.making": "Please wait",
  "take.lost": "No link",
  "take.already": "This picture is still being made. Please wait.",

  "make.expose": "Hold still",
  "make.refine": "Making the picture…",
  "make.keep": "Keeping the picture…",
  "make.progress": "Progress of the picture",
  "make.left": { one: "About {n} second left", other: "About {n} seconds left" },
  "make.soon": "Almost done",

  "mark.quick": "Quick look: not the final picture",
  "mark.final": "Final picture, kept",
  "mark.opening": "Opening the picture…",
  "pic.name": "{mark}. {eye}, {time}. Plus and minus zoom, arrows move, zero shows all.",
  "pic.none": "No picture yet",
  "result.title": "{eye}",
  "result.again": "Take again",
  "result.next": "Next",
  "result.back": "Back to the live picture",
  "result.grey": "Taken in one colour of light: red-free looks the same.",
  "result.details": "Details",
  "detail.method": "Method",
  "detail.rounds": "Rounds",
  "detail.stopped": "Stopped because",
  "detail.seconds": "Time to make",
  "detail.seconds.value": "{s} s",
  "detail.calibration": "Calibration",
  "detail.id": "Name",
  "detail.picture": "Picture (PNG)",
  "detail.raw": "Raw frame",
  "detail.report": "Report",

  "tool.colour": "Colour",
  "tool.plain": "As taken",
  "tool.redfree": "Red-free",
  "tool.contrast": "Contrast",
  "tool.contrast.less": "Less contrast",
  "tool.contrast.more": "More contrast",
  "tool.zoom": "Zoom {z}×",
  "tool.zoom.less": "Zoom out",
  "tool.zoom.more": "Zoom in",
  "tool.reset": "Show all",

  "strip.empty": "Pictures that you take appear here.",
  "strip.open": "{eye} {time}: open this picture",

  "alert.close": "OK",
  "link.lost": "The camera is not answering. Stay close to it. Trying again…",
  "link.cut": "The link broke while the picture was taken.",
  "link.cut.remedy": "If it is not in the list below when the link is back, take it again.",
  "fault.unknown": "The instrument refused, and did not say why.",
  "fault.unknown.remedy": "Wait a moment and try again. If it happens again, call the technician.",
  "fault.picture": "The picture could not be opened.",
  "fault.picture.remedy": "It is kept. Open it again from the list.",
  "swept": {
    one: "Power went off during a picture. Please take it again.",
    other: "Power went off during {n} pictures. Please take them again.",
  },
  "swept.remedy": "Everything that was kept is still in the list.",

  "menu": "Menu",
  "menu.close": "Close",
  "menu.theme": "Screen",
  "theme.dim": "Dim room",
  "theme.daylight": "Daylight",
  "menu.keys": "Keys",
  "menu.letters": "Use the keys G, R, N, + − 0",
  "key.take": "Space or Enter",
  "key.take.what": "Take the picture",
  "key.g": "G",
  "key.g.what": "Red-free or colour",
  "key.contrast": "+ and −",
  "key.contrast.what": "Contrast (zoom when the picture has the focus)",
  "key.zero": "0",
  "key.zero.what": "Show all",
  "key.rn": "R and N",
  "key.rn.what": "Take again, next",
  "menu.technician": "For the technician: calibration",
  "menu.version": "Version {version}",
};

let language = "en-u-nu-latn"; // Latin digits in every language: some locales would otherwise switch to their own
let words = ENGLISH;
let plurals = new Intl.PluralRules(language);

/** Use another language: `table` may be incomplete, English fills the gaps. `tag` is a BCP 47 tag such as "hi". */
export function speak(tag, table) {
  language = `${tag}-u-nu-latn`;
  words = { ...ENGLISH, ...table };
  plurals = new Intl.PluralRules(language);
  document.documentElement.lang = tag;
}

/** The text for `key`, with {names} filled in; a key with a plural is chosen by `vars.n`. */
export function t(key, vars = {}) {
  const entry = words[key];
  if (entry === undefined) throw new Error(`no words for ${key}`);
  const text = typeof entry === "string" ? entry : (entry[plurals.select(vars.n)] ?? entry.other);
  return text.replace(/\{(\w+)\}/g, (_, name) => String(vars[name]));
}

export function clockTime(iso) {
  const form = new Intl.DateTimeFormat(language, { hour: "2-digit", minute: "2-digit", hourCycle: "h23" });
  return form.format(new Date(iso));
}

export function calendarDay(iso) {
  return new Intl.DateTimeFormat(language, { day: "numeric", month: "short", year: "numeric" }).format(new Date(iso));
}

export function isToday(iso) {
  return new Date(iso).toDateString() === new Date().toDateString();
}

/** One decimal at most, in the reader's language. */
export function number(value, digits = 1) {
  return new Intl.NumberFormat(language, { maximumFractionDigits: digits }).format(value);
}
