// Functions that test_viewer.py evaluates in the page: draw pictures with the page's renderers and read the canvas back.
(async () => {
  const { PictureRenderer } = await import(new URL("components/viewer/renderer.js", document.querySelector("script[type=module]").src).href);
  const { openWebgl } = await import(new URL("components/viewer/renderer_webgl.js", document.querySelector("script[type=module]").src).href);
  const { drawLoupe, drawPicture } = await import(new URL("components/viewer/canvas.js", document.querySelector("script[type=module]").src).href);
  const answer = await fetch("/api/captures/any/colour.png");
  const picture = await createImageBitmap(await answer.blob());
  const pixels = (source) => {
    const canvas = Object.assign(document.createElement("canvas"), { width: source.width, height: source.height });
    const context = canvas.getContext("2d", { willReadFrequently: true });
    context.drawImage(source, 0, 0);
    return context.getImageData(0, 0, canvas.width, canvas.height).data;
  };
  const neutral = { redfree: false, brightness: 0, contrast: 0 };

  // A WebGL context in which `overrides` replaces some functions.
  const brokenContext = (overrides) => {
    const gl = openWebgl();
    return new Proxy(gl, {
      get(_, name) {
        const replaced = overrides[name]?.(gl);
        if (replaced) return replaced;
        return typeof gl[name] === "function" ? gl[name].bind(gl) : gl[name];
      },
    });
  };

  window.bench = {
    PictureRenderer,
    openWebgl,
    picture,
    pixels,
    brokenContext,
    neutral,

    /** Return the pixels of the drawn picture: `scale` screen pixels per picture pixel, optionally with a loupe. */
    drawn(renderer, tools, scale, loupe = null) {
      const canvas = Object.assign(document.createElement("canvas"), { width: 700, height: 600 });
      canvas.className = "measured";
      document.body.append(canvas);
      const context = canvas.getContext("2d", { willReadFrequently: true });
      const shown = renderer.render(picture, { ...neutral, ...tools });
      const view = { u: 0.05, v: -0.02, width: picture.width * scale, height: picture.height * scale };
      drawPicture(context, shown, view);
      if (loupe) drawLoupe(context, shown, { ...view, loupe });
      const { data } = context.getImageData(0, 0, 700, 600);
      canvas.remove();
      return data;
    },

    /** Return the largest difference between two lists of values, of 255. */
    maxDifference(a, b) {
      let worst = 0;
      for (let i = 0; i < a.length; i += 1) worst = Math.max(worst, Math.abs(a[i] - b[i]));
      return worst;
    },
  };
})()
