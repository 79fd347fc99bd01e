// Run inside the page by test_viewer.py and the bench: pictures through the page's own painters, read back from a canvas.
(async () => {
  const { Studio } = await import(new URL("painter.js", document.querySelector("script[type=module]").src).href);
  const { openGl } = await import(new URL("painter_gl.js", document.querySelector("script[type=module]").src).href);
  const { lens, place } = await import(new URL("glass.js", document.querySelector("script[type=module]").src).href);
  const answer = await fetch("/api/captures/any/picture.png");
  const picture = await createImageBitmap(await answer.blob());
  const pixels = (source) => {
    const canvas = Object.assign(document.createElement("canvas"), { width: source.width, height: source.height });
    const context = canvas.getContext("2d", { willReadFrequently: true });
    context.drawImage(source, 0, 0);
    return context.getImageData(0, 0, canvas.width, canvas.height).data;
  };
  const neutral = { redfree: false, brightness: 0, contrast: 0 };

  // A chip that does as it is told, except for what `lies` puts in the place of some of its functions.
  const liar = (lies) => {
    const gl = openGl();
    return new Proxy(gl, {
      get(_, name) {
        const made = lies[name]?.(gl);
        if (made) return made;
        return typeof gl[name] === "function" ? gl[name].bind(gl) : gl[name];
      },
    });
  };

  window.bench = {
    Studio,
    openGl,
    picture,
    pixels,
    liar,
    neutral,

    /** The glass with the picture on it: `scale` screen pixels per picture pixel, perhaps with a loupe. */
    glass(studio, tools, scale, loupe = null) {
      const canvas = Object.assign(document.createElement("canvas"), { width: 700, height: 600 });
      canvas.className = "measured";
      document.body.append(canvas);
      const context = canvas.getContext("2d", { willReadFrequently: true });
      const shown = studio.develop(picture, { ...neutral, ...tools });
      const view = { u: 0.05, v: -0.02, width: picture.width * scale, height: picture.height * scale };
      place(context, shown, view);
      if (loupe) lens(context, shown, { ...view, loupe });
      const { data } = context.getImageData(0, 0, 700, 600);
      canvas.remove();
      return data;
    },

    /** The largest difference between two lists of values, of 255. */
    apart(a, b) {
      let worst = 0;
      for (let i = 0; i < a.length; i += 1) worst = Math.max(worst, Math.abs(a[i] - b[i]));
      return worst;
    },
  };
})()
