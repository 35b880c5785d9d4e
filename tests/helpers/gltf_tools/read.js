// Reads glTF files with what is not ours.
//   node read.js validate FILE...   the Khronos validator's issues, a list for each file
//   node read.js values FILE...     every accessor's numbers as glTF-Transform decodes them
// Answers one line of JSON.
const fs = require("fs");

async function validate(path) {
  const { validateBytes } = require("gltf-validator");
  const report = await validateBytes(new Uint8Array(fs.readFileSync(path)), { maxIssues: 100 });
  return report.issues.messages;
}

async function values(path) {
  const { NodeIO } = require("@gltf-transform/core");
  const { ALL_EXTENSIONS } = require("@gltf-transform/extensions");
  const io = new NodeIO().registerExtensions(ALL_EXTENSIONS);
  const document = await io.readBinary(new Uint8Array(fs.readFileSync(path)));
  return document.getRoot().listAccessors().map((accessor) => {
    const rows = [];
    for (let k = 0; k < accessor.getCount(); k++) rows.push(accessor.getElement(k, []));
    return rows;
  });
}

const [task, ...files] = process.argv.slice(2);
Promise.all(files.map({ validate, values }[task])).then((found) => {
  process.stdout.write(JSON.stringify(found));
});
