// Perceptual colour maps of 64 colours each (cividis, magma and viridis from matplotlib, CC0), and the colours of the theme.

const MAPS = {
  cividis: "00224e00255400285b002b62002e6a0030700533711235701a386f213b6e273e6e2d416d32436d36466c3b496c3f4c6c444f6c48526c4c556c50576c545a6d575d6d5b606e5e636f62656f656870696b716c6e727071737374757777767a7a787e7d788280798683798a86788e8978928c78958f779992779d9576a19975a59c74a99f73ada272b1a570b6a96fbaac6dbfb06bc3b369c7b767ccba64d0be62d4c15fd9c55cddc858e1cc55e6d051ead34cefd748f3db42f8df3cfde334fee838",
  magma: "00000402010903031206051a0a08220e0b2b130d34180f3d1d114722115029115a2f116336106b3d0f71440f764a107952137c59157e5f187f651a806b1d81721f817822817e24828426818b2981912b81982d809e2f7fa5317eab337cb2357bba3878c03a76c73d73cd4071d3436ed9466bdf4a68e44f64e95462ed5a5ff1605df4675cf66e5cf8765cfa7d5efb8560fc8e64fd9668fe9d6cfea571feac76feb47bfebb81fec287feca8dfed194fed89afde0a1fde7a9fceeb0fcf6b8fcfdbf",
  viridis: "44015446075a470d6047136548186a481d6f482374482878472d7b46327e453781443b844240864045883e49893d4e8a3a538b38588c365c8d34608d32648e31688e2f6c8e2d708e2c738e2a778e297b8e277f8e26828e24868e238a8d218e8d20928c1f968b1f9a8a1f9e891fa18721a58523a98326ad812ab07f2fb47c35b7793bbb7542be714ac16d52c5695ac86465cb5e6ece5877d15381d34d8bd64695d840a0da39aadc32b5de2bc0df25cae11fd5e21adfe318eae51af4e61efde725",
  gray: "0000000404040808080c0c0c1010101414141818181c1c1c2020202424242828282c2c2c3030303434343838383c3c3c4141414545454949494d4d4d5151515555555959595d5d5d6161616565656969696d6d6d7171717575757979797d7d7d8282828686868a8a8a8e8e8e9292929696969a9a9a9e9e9ea2a2a2a6a6a6aaaaaaaeaeaeb2b2b2b6b6b6babababebebec3c3c3c7c7c7cbcbcbcfcfcfd3d3d3d7d7d7dbdbdbdfdfdfe3e3e3e7e7e7ebebebefefeff3f3f3f7f7f7fbfbfbffffff",
};
export const NAMES = ["cividis", "magma", "viridis", "gray", "gray reversed"];

/** RGBA bytes [256 * 4] of a map, interpolated. */
export function lut(name) {
  const reversed = name.endsWith(" reversed");
  const hex = MAPS[name.replace(" reversed", "")] ?? MAPS.cividis;
  const out = new Uint8Array(256 * 4);
  for (let i = 0; i < 256; i++) {
    const at = ((reversed ? 255 - i : i) / 255) * 63, k = Math.min(Math.floor(at), 62), f = at - k;
    for (let c = 0; c < 3; c++) {
      const a = parseInt(hex.substr(6 * k + 2 * c, 2), 16), b = parseInt(hex.substr(6 * k + 6 + 2 * c, 2), 16);
      out[4 * i + c] = Math.round(a + f * (b - a));
    }
    out[4 * i + 3] = 255;
  }
  return out;
}

/** A colour of the theme by its name in style.css. */
export function ink(name) {
  return getComputedStyle(document.documentElement).getPropertyValue(`--${name}`).trim();
}

/** A colour bar with numbers at its ends. */
export function bar(name, low, high, title) {
  const canvas = document.createElement("canvas");
  canvas.width = 256;
  canvas.height = 1;
  canvas.setAttribute("aria-hidden", "true");
  const image = new ImageData(new Uint8ClampedArray(lut(name)), 256, 1);
  canvas.getContext("2d").putImageData(image, 0, 0);
  const ends = document.createElement("div"), words = document.createElement("div");
  ends.className = "ends";
  for (const text of [low, high]) ends.appendChild(document.createElement("span")).textContent = text;
  words.textContent = title;
  return [words, canvas, ends];
}

/** Draw pixels [height][width], first row at the bottom, in grey with an asinh stretch from the sky level to the brightest pixel. */
export function stretched(pixels, width, height) {
  const sorted = pixels.filter(Number.isFinite).sort(), at = (share) => sorted[Math.floor(share * (sorted.length - 1))] ?? 0;
  const sky = at(0.5), noise = Math.max(sky - at(0.16), 1e-6 * Math.abs(at(1)), 1e-9), top = Math.max(at(0.9995), sky + 8 * noise);
  const colours = lut("gray"), image = new ImageData(width, height);
  for (let row = 0; row < height; row++) {
    for (let column = 0; column < width; column++) {
      const value = pixels[row * width + column], share = Math.asinh((value - sky + 1.5 * noise) / (3 * noise)) / Math.asinh((top - sky + 1.5 * noise) / (3 * noise));
      const k = Number.isFinite(value) ? 4 * Math.round(255 * Math.min(1, Math.max(0, share))) : 0;
      image.data.set(colours.subarray(k, k + 4), 4 * ((height - 1 - row) * width + column));
    }
  }
  return image;
}

/** Compile a shader program. */
export function program(gl, vertex, fragment) {
  const made = gl.createProgram();
  for (const [kind, source] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
    const shader = gl.createShader(kind);
    gl.shaderSource(shader, `#version 300 es\nprecision highp float;\nprecision highp sampler2D;\n${source}`);
    gl.compileShader(shader);
    if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
    gl.attachShader(made, shader);
  }
  gl.linkProgram(made);
  if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
  return made;
}

/** Create or update the texture of a colour map. */
export function lutTexture(gl, name, old) {
  const texture = old ?? gl.createTexture();
  gl.bindTexture(gl.TEXTURE_2D, texture);
  gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGBA, 256, 1, 0, gl.RGBA, gl.UNSIGNED_BYTE, lut(name));
  for (const key of [gl.TEXTURE_MIN_FILTER, gl.TEXTURE_MAG_FILTER]) gl.texParameteri(gl.TEXTURE_2D, key, gl.LINEAR);
  for (const key of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, key, gl.CLAMP_TO_EDGE);
  return texture;
}
