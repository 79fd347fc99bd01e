// Layout and accessibility checks that looks.py evaluates in the page, on computed colours, boxes after layout and
// accessible names. Returns each violation as a sentence.
(inView) => {
  const faults = [];
  const scope = document.querySelector("dialog[open]") ?? document.body;
  const shown = (el) => el.checkVisibility({ visibilityProperty: true, opacityProperty: true });
  const labelOf = (el) => (el.ariaLabel ?? el.textContent ?? "").trim().replace(/\s+/g, " ").slice(0, 40);
  const name = (el) => `${el.tagName.toLowerCase()}#${el.id} "${labelOf(el)}"`;
  const rgb = (text) => text.match(/[\d.]+/g).map(Number);
  const light = ([r, g, b]) => [r, g, b]
    .map((v) => v / 255)
    .map((v) => (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4))
    .reduce((sum, v, i) => sum + v * [0.2126, 0.7152, 0.0722][i], 0);
  const contrast = (a, b) => (Math.max(light(a), light(b)) + 0.05) / (Math.min(light(a), light(b)) + 0.05);
  const ground = (el) => {
    for (let at = el; at; at = at.parentElement) {
      const colour = rgb(getComputedStyle(at).backgroundColor);
      if (colour.length === 3 || colour[3] > 0.99) return colour;
    }
    return [255, 255, 255];
  };

  const { scrollWidth } = document.documentElement;
  if (scrollWidth > innerWidth) faults.push(`sideways scroll: ${scrollWidth} > ${innerWidth}`);

  for (const el of scope.querySelectorAll("button, a, summary, input, select, label")) {
    if (!shown(el) || el.matches("label input")) continue;
    const box = el.getBoundingClientRect();
    const least = el.id === "shutter" ? 84 : 48;
    const narrow = el.matches("button, .button") && box.width < 48;
    if (box.height < least - 0.01 || narrow) faults.push(`too small: ${name(el)} ${box.width}x${box.height}`);
    if (!labelOf(el)) faults.push(`no name: ${name(el)}`);
    if (el.scrollWidth > el.clientWidth + 1) faults.push(`words cut off: ${name(el)}`);
  }

  const walker = document.createTreeWalker(scope, NodeFilter.SHOW_TEXT);
  while (walker.nextNode()) {
    const el = walker.currentNode.parentElement;
    if (!walker.currentNode.data.trim() || !el || !shown(el)) continue;
    if (el.closest("script, noscript, .unseen, dialog:not([open])")) continue;
    const control = el.closest("button, .button, .card, .prompt, .notices li, .state-bar");
    const glyphs = document.createRange();
    glyphs.selectNodeContents(walker.currentNode);
    const [ink, frame] = [glyphs.getBoundingClientRect(), (control ?? document.documentElement).getBoundingClientRect()];
    const scrolls = control?.matches(".card");
    if (ink.left < frame.left - 1 || ink.right > frame.right + 1) faults.push(`words stick out sideways: ${name(el)}`);
    const room = 1 + parseFloat(getComputedStyle(el).fontSize) / 6; // a line box can be lower than its glyphs
    if (control && !scrolls && (ink.top < frame.top - room || ink.bottom > frame.bottom + room)) faults.push(`words stick out: ${name(el)}`);
    const style = getComputedStyle(el);
    if (parseFloat(style.fontSize) < 18) faults.push(`small text: ${name(el)} ${style.fontSize}`);
    const ratio = contrast(rgb(style.color), ground(el));
    if (ratio < 7) faults.push(`low contrast ${ratio.toFixed(1)}: ${name(el)}`);
  }

  for (const el of scope.querySelectorAll("button")) {
    if (!shown(el)) continue;
    const style = getComputedStyle(el);
    const own = rgb(style.backgroundColor);
    const around = ground(el.parentElement);
    const edge = Math.max(contrast(rgb(style.borderTopColor), around), own.length === 3 ? contrast(own, around) : 0);
    if (!el.classList.contains("quiet") && edge < 3) faults.push(`pale border ${edge.toFixed(1)}: ${name(el)}`);
  }

  for (const selector of inView) {
    const el = document.querySelector(selector);
    const box = el?.getBoundingClientRect();
    if (!box || box.top < 0 || box.left < 0 || box.bottom > innerHeight || box.right > innerWidth) {
      faults.push(`not in view: ${selector} ${JSON.stringify(box)}`);
      continue;
    }
    const top = document.elementFromPoint(box.left + box.width / 2, box.top + box.height / 2);
    if (!el.contains(top)) faults.push(`covered: ${selector} by ${name(top)}`);
  }

  if (document.querySelector(".exam")) {
    const stage = document.querySelector(".stage").getBoundingClientRect();
    const prompt = document.querySelector(".prompt").getBoundingClientRect();
    if (prompt.top < stage.bottom) faults.push("the words under the picture cover it");
    const below = document.querySelector(".panel").getBoundingClientRect();
    if (prompt.bottom > below.top && prompt.right > below.left) faults.push("the words under the picture lie over the controls");
    if (stage.height < 140) faults.push(`the picture is only ${stage.height} high`);
  } else if (document.querySelector(".prompt")) {
    const stage = document.querySelector(".stage")?.getBoundingClientRect();
    const prompt = document.querySelector(".prompt").getBoundingClientRect();
    const apart = !stage || prompt.top >= stage.bottom || prompt.bottom <= stage.top || prompt.left >= stage.right;
    if (!apart) faults.push("the words beside the picture cover it");
    if (stage?.height < 140) faults.push(`the picture is only ${stage.height} high`);
  }

  for (const role of ["main", "header", "h1", "[role=status]"]) {
    if (document.querySelectorAll(role).length !== 1) faults.push(`not exactly one ${role}`);
  }
  return faults;
}
