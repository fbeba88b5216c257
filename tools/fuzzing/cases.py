"""The kinds of inputs: patterns of cases, which use the names of `workbench` and the parts of `parts`."""

from __future__ import annotations

from .parts import cases
from .runner import Kind

KINDS = (
    Kind(
        "EXR: damaged bytes",
        14,
        cases("read(damaged(<<$exr | 'refocused.exr' | 'views.exr' | 'foreign.exr'>>, $edits))"),
    ),
    Kind(
        "EXR: changed header",
        12,
        cases(r"""
        read(lying($exr, <<'dataWindow' | 'displayWindow'>>, None, pack('<4i', $edge, $edge, $edge, $edge)))
        ! read(lying($exr, 'dataWindow', None, pack('<4i', 0, 0, <<0 | 1 | 31 | 62 | 64>>, <<63 | 10**9 | $size>>)))
        ! read(lying($exr, 'channels', None, b'' <<$bytes | b'Y\0' b'\2\0\0\0'>>))
        ! read(lying($exr, 'channels', None, channels(*<<'' | 'Z' | 'R' | 'RG' | 'YY' | 'RGBY' | ['Y' * 300]>>)))
        ! read(lying($exr, 'channels', None, channels('Y', kind=<<3 | -1>>)))
        ! read(lying($exr, 'channels', None, channels('Y', every=<<0 | 2 | -1 | 2**31 - 1>>)))
        ! read(lying($exr, 'channels', None, channels(*map(str, range(1000)))))
        read(lying($exr, 'compression', None, $bytes[:1]))
        read(lying($exr, $attribute, None, None))
        read(lying($exr, $attribute, <<'int' | 'nosuch' | 'box2f' | 'opaque' | 'preview' | 'timecode'>>, None))
        read(lying($exr, $attribute, None, $bytes * <<0 | 1 | 3 | 5_000>>))
        read(misplaced($exr, 8 * <<0 | 1 | 2 | 3>>, pack('<Q', <<0 | 1 | 8 | 2**32 | 10**9 | 2**63 | 2**64 - 1>>)))
        ! read(misplaced($exr, <<32 | 36>>, pack('<i', <<-1 | 7 | 65535 | 10**9 | 2**31 - 1 | -(2**31)>>)))
        read(damaged($exr, [(4, 4, pack('<i', <<0 | 1 | 3 | 0x202 | 0x802 | 0x1002 | 0x10002 | 2**31 - 1>>))]))
        ! read(poisoned($exr, $pixel, <<nan | inf | -inf | $too_bright>>))
        """),
    ),
    Kind(
        "EXR: changed JSON",
        10,
        cases(r"""
        ! read(relabelled($exr, camera={**CAMERA.to_dict(), **dict($wrong)}))
        ! read(relabelled($exr, camera={**CAMERA.to_dict(), $any_text: 1.0}))
        ! read(relabelled($exr, camera={'focal_length': 80.0}))
        ! read(relabelled($exr, camera=<<... | None | 3 | [] | 'camera' | {} | [1, 2]>>))
        ! read(relabelled($exr, kind=<<... | 'reconstruction' | '' | None | 1 | [] | {'a': 1} | 'capture\n'>>))
        ! read(relabelled($exr, model=<<... | 'magic' | '' | None | 3 | [] | {} | 'RAY' | '\x1b]0;title\x07'>>))
        ! read(relabelled($exr, metadata=<<'text' | 3 | ['a'] | True | 1.5>>))
        ! read(relabelled($exr, wavelength=<<-1 | 0 | '633' | [] | [1.0, 2.0] | {} | True | nan | inf | 1e300>>))
        ! read(relabelled($exr, <<'' | '{' | '[]' | 'null' | '{"kind": "capture"} extra' | 'cos\nsystem\n.'>>))
        ! read(relabelled($exr, <<'[' * 100_000 | '{"a":' * 100_000 | '9' * 100_000>>))
        ! read(relabelled($exr, '{"kind": "capture", "camera": {"focal_length": ' + '9' * 5000 + '}}'))
        """),
    ),
    Kind(
        "XML: damaged bytes",
        8,
        cases("""
        load_scene(scene(beside=damaged(<<'scene.xml' | 'square.ply' | 'dots.png'>>, $edits))) and None
        render(beside=damaged(<<'scene.xml' | 'square.ply' | 'dots.png'>>, $edits))
        """),
    ),
    Kind(
        "XML: forbidden value",
        8,
        cases("""
        ! render(sensor(<<'float' | 'string'>>, '$length', $length_text))
        ! render(sensor('float', 'focus_distance', <<'80' | $low_text>>))
        ! render(sensor(<<'string' | 'integer'>>, 'lens_model', $number_text))
        ! render(sensor('float', <<'focal_lenght' | 'near_clip'>>, '1'))
        ! render(sensor(<<'vector' | 'rgb'>>, '$length', '1, 2, 3'))
        ! render((SENSOR, SENSOR + '<transform name="<<$length | to_world>>"><scale value="2"/></transform>'))
        ! render((SENSOR, SENSOR + '<transform name="to_world"><translate x="<<nan | inf>>"/></transform>'))
        ! render(sensor('float', 'mla_distance', '120'), (SENSOR, SENSOR + element('float', 'focus_distance', '240')))
        ! render(sensor('float', 'shutter_open', '2'))
        ! render(waves(<<'string' | 'float'>>, 'wavelength', <<$wavelength_text | '1,2' | ','>>))
        ! render(waves('integer', 'radiators_per_lens', <<$length_text | '2.5' | '257'>>))
        ! render(waves('integer', 'passes', <<$length_text | '2.5'>>))
        ! render(waves('string', 'method', $name_text))
        ! render(waves('boolean', 'occlusion', <<'maybe' | '2' | ''>>))
        ! render(waves('float', 'accuracy', <<$infinite_text | '-0.1' | '1' | '2'>>))
        ! render((FILM, element('integer', 'width', <<'0' | '-1' | '1.5' | $word_text | '2147483648' | '2097152'>>)))
        ! render((FILM, FILM + element('integer', 'crop_width', <<'0' | '-1' | '17' | '99999'>>)))
        ! render((FILM, FILM + element('integer', 'crop_offset_x', <<'-1' | '17' | '2147483647'>>)))
        """),
    ),
    Kind(
        "XML: hostile",
        6,
        cases(r"""
        ! render(beside=holding('scene.xml', <<'<html></html>' | '' | 'scene' | '<scene version="3.0.0"/>'>>))
        ! render(beside=holding('scene.xml', SCENE.encode(<<'utf-16' | 'utf-32' | 'cp037'>>)))
        ! render(beside=holding('scene.xml', SCENE.encode() + <<b'\xff' | b'<scene/>' | $bytes + b'>'>>))
        ! render(beside=holding('scene.xml', '<!DOCTYPE s [<!ENTITY x SYSTEM "/etc/passwd">]><scene>&x;</scene>'))
        ! render(beside=holding('scene.xml', laughs(<<1 | 2 | 9 | 19>>)))
        ! render(('<emitter', nested(<<'bsdf' | 'shape' | 'x' | 'integrator'>>, <<65 | 100 | 1000 | 100_000>>)))
        ! render(('<emitter', '<include filename="i0.xml"/><emitter'), beside=includes(<<'i0' | 'i{}' | 'i{0} i{0}'>>))
        ! render(('type="<<constant | path>>"', 'type="<<../../evil | /tmp/evil | nosuch |  | a b | ..>>"'))
        ! render(('<emitter', '<alias id="x" as="<<../evil | nosuch | ..>>"/><emitter'))
        ! render(('square.ply', <<'/dev/zero' | '/dev/stdin' | '/dev/random' | '/dev/tty' | '/proc/self/mem' | '/'>>))
        ! render(('square.ply', <<'' | 'square.ply/x' | 'x' * 5000 | 'scene.xml' | '/nowhere/a.ply' | 'a\0b'>>))
        ! render(('square.ply', 'pipe'), beside=os.mkfifo('pipe'))
        ! render(beside=holding('square.ply', PLY.replace(b'vertex 3', b'vertex <<-5 | 1e9 | 2147483647 | $size>>')))
        ! render(beside=holding('plugins/<<evil.so | path.so | evil.dylib | x.so.1>>', b'\x7fELF'))
        ! render(beside=png('dots.png', $size, $size))
        ! render(('type="plenoptic"', 'type="perspective"'))
        ! render((' version="3.0.0"', '<< |  version="x.y">>'))
        ! render(('<sampler', '<sensor type="plenoptic"/><sampler'))
        ! render(('type="path"', 'type="ptracer"'))
        ! render(('type="path"/>', 'type="aov"><string name="aovs" value="d:depth"/></integrator>'))
        ! render(('type="path"', 'type="plenoptic_wave"'), ('"box"', '"gaussian"'))
        ! render(('<emitter', '<ref id="nowhere"/><emitter'))
        ! render(('<default name="resolution" value="16"/>', ''))
        ! render(('type="constant"/>', 'type="constant"><spectrum name="radiance" value="<<nan | inf>>"/></emitter>'))
        """),
    ),
    Kind(
        "command line",
        12,
        cases(r"""
        ! command('render', <<'nosuch' | '' | '.' | 'letters.xml' | '/dev/zero' | '\0' | $file>>, '-o', 'out.exr')
        ! command('render', 'white', '-Dresolution=256', '--spp=1', '-o', $output)
        ! command(*RENDER, '--spp=' + $count_text)
        ! command(*RENDER, '--seed=' + <<$seed_text | '4294967296'>>)
        ! command(*RENDER, <<'--wavelength=633' | '--model=' + $name_text>>)
        ! command(*RENDER, '--variant=<<nosuch | scalar_rgb | llvm_ad_mono >>')
        ! command(*RENDER, '--spp=1', '-D', '$length=' + $length_text)
        ! command(*RENDER, '--spp=1', '-D', 'resolution=' + <<$count_text | '65536'>>)
        ! command(*RENDER, '-D', <<'' | 'resolution' | '=3' | 'nosuch=1' | '\0=1' | '\x24x=1'>>)
        ! command(*RENDER, '--model=wave', '--wavelength=' + <<$wavelength_text | '1,2,3'>>)
        ! command(*RENDER, '--model=wave', '--radiators-per-lens=' + <<$count_text | '257'>>)
        ! command('reconstruct', $file, '-o', 'out.exr', '--distance=240')
        ! command('reconstruct', 'grey.exr', '-o', $output, '--distance=240')
        ! command('reconstruct', 'grey.exr', '-o', 'out.exr', '--distance=' + <<$length_text | '80' | '79.9'>>)
        ! command(*REFOCUS, '--<<method | footprint>>=' + $name_text)
        ! command(*REFOCUS, '--oversample=' + $count_text)
        ! command(*REFOCUS, '--method=partial', '--interleave=' + <<$count_text | 'AUTO' | '\u00b2'>>)
        ! command(*REFOCUS, '--method=partial', '--wavelength=' + $wavelength_text)
        ! command(<<'views' | 'epi' | 'depth'>>, 'grey.exr', '-o', $output)
        ! command(<<'views' | 'epi' | 'depth' | 'info' | 'expose'>>, $file, '-o', 'out.exr')
        ! command(<<'views' | 'epi' | 'depth'>>, 'grey.exr', '-o', 'out.exr', '--white', $file)
        ! command('views', 'grey.exr', '-o', 'out.exr', '--<<count | view-count>>=' + <<$count_text | '1000'>>)
        ! command('epi', 'grey.exr', '-o', 'out.exr', '--axis=' + $name_text)
        ! command('epi', 'grey.exr', '-o', 'out.exr', '--<<at | through>>=' + <<$word_text | $infinite_text>>)
        ! command('stack', 'grey.exr', '-o', 'out.exr', '--distance=' + <<$word_text | $low_text | '80' | 'nan'>>)
        ! command('stack', 'grey.exr', '-o', 'out.exr', '--distance=240', '--method=' + $name_text)
        ! command('depth', 'grey.exr', '-o', 'out.exr', '--near=' + <<$number_text | '80' | '1e300'>>)
        ! command('depth', 'grey.exr', '-o', 'out.exr', '--far=' + <<$word_text | $low_text | 'nan' | '81'>>)
        ! command('depth', 'grey.exr', '-o', 'out.exr', '--planes=' + <<$count_text | '2' | '1025'>>)
        ! command('expose', 'grey.exr', '-o', 'out.exr', '--photons=' + $length_text)
        ! command(*EXPOSE, '--<<quantum-efficiency | full-well | gain>>=' + $length_text)
        ! command(*EXPOSE, '--<<dark-electrons | read-noise>>=' + $amount_text)
        ! command(*EXPOSE, '--bits=' + <<$count_text | '17'>>)
        ! command(*EXPOSE, '--black-level=' + <<$seed_text | '4095' | '9' * 5000>>)
        ! command(*EXPOSE, '--seed=' + $seed_text)
        ! command('convert', 'grey.exr', '-o', <<'out' | 'out.exr' | 'out.jpg' | 'nowhere/out.mat'>>)
        ! command('convert', 'grey.exr', '-o', 'out.mat', '--view-count=' + <<$count_text | '3'>>)
        ! command('info', 'grey.exr', '--wavelength=' + $wavelength_text)
        ! command('info', 'letters', '-D', '$length=' + $length_text)
        ! command('compare', 'letters', '-o', 'out', '-Dresolution=256', '--distance=' + $number_text)
        ! command(*COMPARE, '--wavelength=' + $wavelength_text)
        ! command(*COMPARE, '--<<radiators-per-lens | spp>>=' + $count_text)
        ! command(*COMPARE, <<'--variant=nosuch' | '--variant=llvm_ad_rgb' | '-Dnosuch=1' | '-Dmla_pitch=nan'>>)
        ! command(<<'nosuch' | 'render' | '--nosuch' | 'info' | 'ren der' | '\x1b[31m' | $name_text>>)
        ! command('render', 'white', <<'-o' | '--nosuch' | 'extra'>>, '-o', 'out.exr')
        ! command('reproduce', '-o', <<'grey.exr' | 'out', '--preset', 'magic'>>)
        ! command(<<'views' | 'depth' | 'info'>>, damaged('grey.exr', [($place, 2**30, b'')]), '-o', 'out.exr')
        ! command('reconstruct', damaged('grey.exr', [($place, 2**30, b'')]), '-o', 'out.exr', '--distance=240')
        """),
    ),
    Kind(
        "Python: camera",
        12,
        cases("""
        ! PlenopticCamera($wrong)
        ! CAMERA.replace($wrong)
        ! PlenopticCamera.from_dict({**CAMERA.to_dict(), **dict($wrong)})
        ! PlenopticCamera.from_dict({**CAMERA.to_dict(), $any_text: 1.0})
        design($camera, '$nm')
        design($camera, '$nm')
        """),
    ),
    Kind(
        "Python: array",
        8,
        cases("""
        ! $use(image(at=$pixel, to=<<nan | inf | -inf | $too_bright>>))
        ! $use(<<image()[:5] | image()[None] | np.zeros(0) | np.zeros((64, 64, 2)) | np.zeros((64, 64, 0))>>)
        ! $use(image().astype(<<complex | bool | str | object>>))
        ! $use(<<'image' | 3 | {} | [[1, 2], [3]] | [['a'] * 64] * 64 | np.zeros((64, 63)) | np.full((64, 64), 1e300)>>)
        ! $use(np.zeros((64, 64), <<'M8[s]' | [('a', 'f4')]>>))
        $use((image() * 100).astype(<<'u1' | 'i2' | 'u8' | '>f4' | 'f2' | 'f8'>>))
        $use(<<np.zeros((64, 64)) | image() * 1e-38 | np.asfortranarray(image())[::-1] | -image() | capture(3).image>>)
        $use(image(at=$pixel, to=$value))
        """),
    ),
    Kind(
        "Python: argument",
        14,
        cases(r"""
        ! reconstruct(capture(), $not_distance)
        ! reconstruct(capture(), 240, <<method | footprint>>=$not_name)
        ! reconstruct(capture(), 240, oversample=<<$not_count | 100_000 | 10**9>>)
        ! reconstruct(capture(), 240, method='partial', interleave=<<$not_count | 10**9 | 'AUTO'>>)
        ! reconstruct(capture(), 240, camera=<<'camera' | 1 | {} | SMALL_CAMERA>>)
        ! reconstruct(image(), 240, camera=CAMERA, method=<<'coherent' | 'partial'>>, wavelength=$not_wavelength)
        ! reconstruct(image(at=$pixel, to=-1e-3), 240, camera=CAMERA, method='coherent', wavelength=633)
        ! decode(image(), camera=<<None | SMALL_CAMERA | 'x' | 3 | {}>>)
        ! decode(image(), camera=CAMERA, <<white=image()[:5] | grid='x' | grid=3>>)
        ! decode(image(), <<white=image() * 0 | white=None>>, grid=LensGrid((16.0, 16.0), (8.0, 8.0), (4, 4)))
        ! decode(image(), white=image(), grid=LensGrid((1e-3, 1e-3), (0, 0), (10**6, 10**6)))
        ! CaptureOperator(CAMERA, [(0, 0, <<0 | -5 | nan | inf | 1e300 | 'a'>>)], wavelength=633)
        ! CaptureOperator(CAMERA, [(0, 0, 240)], wavelength=$not_wavelength)
        ! CaptureOperator(CAMERA, [(0, 0, 240)], wavelength=633, <<method=$not_name | accuracy=1 | accuracy=nan>>)
        ! CaptureOperator(CAMERA, [(0, 0, 240)], wavelength=633, pupil_weights=<<[1] | [[[-1.0]]] | [[[nan]]] | 'a'>>)
        ! CaptureOperator(CAMERA, [(0, 0, 240)], wavelength=633).forward(<<[nan] | [[inf]] | [1, 2] | 'a' | [[]]>>)
        ! CaptureOperator(CAMERA, [(0, 0, 240)], wavelength=633).adjoint(<<image()[:5] | image() * nan | 'a' | None>>)
        CaptureOperator(CAMERA, [(0, 0, 240)], wavelength=633).forward([<<0 | -1 | 1e-30 | 1e30>>])
        ! Detector(<<quantum_efficiency | full_well>>=<<$not_length | None>>)
        ! Detector(<<gain=$not_length | quantum_efficiency=1.0001 | full_well=0.5>>)
        ! Detector(<<dark_electrons | read_noise>>=$not_amount)
        ! Detector(bits=<<$not_count | 17 | 1000>>)
        ! Detector(black_level=<<$not_place | $not_whole | -1 | 4095 | 10**9>>)
        ! expose(capture(), Detector(), photons=<<$not_length | None>>)
        ! expose(capture(), Detector(), photons=10, seed=<<$not_place | $not_whole | -1 | None>>)
        ! point_spread_function(CAMERA, (0, 0, 240), wavelength=$not_wavelength, method=<<'patch' | 'full_field'>>)
        ! point_spread_function(CAMERA, (0, 0, 240), wavelength=633, method=$not_name)
        ! point_spread_function(CAMERA, <<None | 240.0 | 'abc' | [] | (0, 0) | (0, 0, 0, 240) | {1, 2}>>, wavelength=5)
        ! point_spread_function(CAMERA, (0, 0, <<-240 | 0 | nan | 10**400 | 1e300 | 1e-300 | 'a'>>), wavelength=633)
        ! $light_field_use(light_field()<<.values | [0] | .drop_vars('weight') | .transpose('s', 't', 'u', 'v')>>)
        ! $light_field_use(<<None | light_field().where(light_field() > 0) | light_field() * np.inf>>)
        ! refocus(light_field(), $not_distance)
        ! focal_stack(light_field(), <<[] | [240.0], method='magic' | [240.0], method=None>>)
        ! shift_and_add(light_field(), <<$not_place | None>>)
        ! depth_map(light_field(), planes=<<$not_count | 1 | 2 | 10**6>>)
        ! depth_map(light_field(), near=<<$not_place | 400>>, far=300)
        ! view(light_field(), v=<<$not_place | None>>)
        ! pick_views(light_field(), <<$not_count | 1000>>)
        ! view(light_field(), u=<<$not_place | None>>)
        ! epipolar_image(light_field(), <<$not_name | at=$not_place>>)
        ! FourierRefocuser(light_field(), <<$not_place | None>>)
        ! read_capture(<<$file | None | 3 | b'x.exr' | os.mkdir('x.exr') or 'x.exr' | file('grey.exr') + '/raw.exr'>>)
        ! write_capture(<<'' | '.' | '/' | 'a\0b.exr' | 'x' * 5000 | 'nowhere/raw.exr'>>, capture())
        ! write_capture(<<None | 3 | b'x' | os.mkdir('x.exr') or 'x.exr' | file('grey.exr') + '/raw.exr'>>, capture())
        ! write_capture(<<'/dev/null' | '/dev/full' | '/proc/version'>>, capture())
        ! LensGrid(($not_length, 16.0), (8.0, 8.0), (4, 4))
        ! LensGrid((16.0, 16.0), (8.0, $not_place), (4, 4))
        ! LensGrid((16.0, 16.0), (8.0, 8.0), (4, $not_count))
        ! LensGrid((16.0, 16.0), <<(4,) | 4 | None | 'ab' | (8.0, 8.0), (4, 4, 4)>>, (4, 4))
        ! LensGrid((16.0, 16.0), (8.0, 8.0), (4, 4), rotation=<<$not_place | None>>)
        ! LensGrid((16.0, 16.0), (8.0, 8.0), (4, 4), shifted_rows=<<2 | -1 | 'x' | 0.5 | nan | [0]>>)
        """),
    ),
    Kind(
        "Python: extreme camera",
        4,
        cases("""
        (lambda c: white_image(c))($camera)
        (lambda c: render_capture(wall(c, $far), spp=1))($camera)
        (lambda c: render_capture(wall(c, $far), model='wave', spp=1, radiators_per_lens=1))($camera)
        (lambda c: decode(noise(c), camera=c))($camera)
        (lambda c: focal_stack(decode(noise(c), camera=c), [$far]))($camera)
        (lambda c: depth_map(decode(noise(c), camera=c), planes=3))($camera)
        (lambda c: reconstruct(noise(c), $far, camera=c, oversample=$few))($camera)
        (lambda c: reconstruct(noise(c), $far, camera=c, footprint='point'))($camera)
        (lambda c: reconstruct(noise(c), $far, camera=c, method='coherent', wavelength=$nm))($camera)
        (lambda c: reconstruct(noise(c), $far, camera=c, method='partial', interleave=$few, wavelength=$nm))($camera)
        (lambda c: reconstruct(noise(c), $far, camera=c, method='partial', interleave='auto', wavelength=$nm))($camera)
        (lambda c: point_spread_function(c, (0, 0, $far), wavelength=$nm))($camera)
        (lambda c: point_spread_function(c, (0, 0, $far), wavelength=$nm, method='full_field'))($camera)
        """),
    ),
    Kind(
        "checkpoint",
        5,
        cases("""
        resume(damaged('stopped.checkpoint', $edits))
        ! resume(lying_checkpoint(<<format=99 | format='1' | image=nan | image=inf>>))
        ! resume(lying_checkpoint(<<sums | batches>>=<<-1 | 10**9 | 'a' | 0.5 | [] | None>>))
        ! resume(lying_checkpoint(run=<<{} | None | [] | {'camera': 1}>>))
        """),
    ),
    Kind(
        "grid of a sweep",
        5,
        cases(r"""
        sweep('--grid', damaged('grid.yaml', $edits))
        ! sweep('--grid', holding('grid.yaml', <<'' | '[]' | '3' | 'text' | 'a: []' | 'a: {b: 1}' | 'a: [1, [2]]'>>))
        ! sweep('--grid', holding('grid.yaml', 'a: [<<true | null | 1, 1 | .nan | .inf | 2020-01-01 | *nowhere>>]'))
        ! sweep('--grid', holding('grid.yaml', <<'1: [2]' | 'a b: [1]' | '? [1]\n: [2]' | 'a: [1]\na: [2]'>>))
        ! sweep('--grid', holding('grid.yaml', <<'a: [' | '\t' | b'\xff\xfe\0' | b'a: [1]\0' | 'a: &a [*a]'>>))
        ! sweep('--grid', holding('grid.yaml', 'a: !!python/object/apply:os.system ["touch hacked"]'))
        ! sweep('--grid', holding('grid.yaml', <<'[' * 10_000 | 'a: [' * 5_000 | 'a: ' + '9' * 10_000>>))
        ! sweep('--grid', holding('grid.yaml', 'a: [' + ', '.join(map(str, range(<<3_000 | 150_001>>))) + ']'))
        ! sweep('--grid', holding('grid.yaml', growing(<<3 | 12>>)))
        ! sweep('--vary', 'a=' + <<$word_text | $infinite_text | '1,1' | '1,'>>)
        ! sweep('--vary', <<'a' | '=1' | 'a=' | 'a b=1' | '1=1' | '\0=1' | 'samples=1', '--vary', 'samples=2'>>)
        ! sweep('--vary', 'a=1,2', '--vary', 'b=' + ','.join(map(str, range(60_000))))
        """),
    ),
    Kind(
        "MAT, HDF5, PNG: damaged bytes",
        8,
        cases("""
        open_light_field(damaged(<<'uint8.mat' | 'uint16.mat' | 'single.mat'>>, $edits))
        open_light_field(damaged('version7.mat', $edits))
        open_views(damaged(<<'views.png' | 'lenses.eslf.png'>>, $edits))
        """),
    ),
    Kind(
        "MAT, HDF5, PNG: lies",
        8,
        cases(r"""
        ! open_light_field(matlab(LF=<<ONES[0, 0] | ONES[..., :0] | ONES * 1j | np.ones((2, 2, 3, 3, 7), 'u1')>>))
        ! open_light_field(matlab(LF=<<'text' | {'a': 1} | np.array([[1, 'a']], object) | nan>>))
        ! open_light_field(matlab(XX=ONES))
        ! open_light_field(matlab(LF=ONES.astype('f4') * [1, <<nan | inf | -inf | 3e38>>]))
        ! open_light_field(matlab(LF=ONES, MaxLum=<<nan | inf | -inf | -1.0 | 'a' | 1e38>>))
        ! open_light_field(matlab(LF=ONES, LensletGridModel={**GRID_MODEL, $grid_name: <<nan | inf | 'wide' | 1j>>}))
        ! open_light_field(matlab(LF=ONES, LensletGridModel={**GRID_MODEL, $grid_name: <<[1.0, 2.0] | {'a': 1.0}>>}))
        ! open_light_field(matlab(LF=ONES, LensletGridModel={'HSpacing': <<16.0 | np.zeros(4_000_000)>>}))
        ! open_light_field(matlab(LF=ONES, Camera=<<'{' * 50_000 | 'cos\nsystem\n.' | '[]' | 'x' + $any_text>>))
        ! open_light_field(matlab(LF=ONES, Camera=json.dumps({**CAMERA.to_dict(), '$length': <<-1 | 'x' | nan | []>>})))
        ! open_light_field(hdf5(LF=<<'text' | ONES.T * nan | np.ones((9, 4, 4, 3, 3)) | h5py.Empty('f4')>>))
        ! open_light_field(hdf5(LF=<<h5py.SoftLink('/nowhere') | h5py.ExternalLink('/dev/zero', 'LF')>>))
        ! open_light_field(hdf5(LF=np.zeros((2, 4, 4, 3, 3), [('a', 'f4')])))
        ! open_light_field(hdf5(new={'shape': (2, <<10**6 | 2**15>>, 10**6, 9, 9), 'chunks': (1, 16, 16, 3, 3)}))
        ! open_light_field(hdf5(new={'shape': (2, 4, 4, 3, 3), 'external': [(file('grey.exr'), 0, 288)]}))
        ! open_views(png('views.png', <<0 | 1 | 60_000 | $size>>, $size, <<8 | 16 | 7>>, <<0 | 2 | 3 | 6 | 9>>))
        ! open_views(png('views.png', 64, <<0 | 2**31 - 1 | $size>>, text=10_000_000))
        """),
    ),
)
